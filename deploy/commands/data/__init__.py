"""Commands for logs and for other tools' file formats."""
