"""Configuration files of the agents: schemas and the TOML reader."""
