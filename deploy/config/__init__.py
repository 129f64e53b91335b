"""Configuration files of the agents: structs and their reader."""
