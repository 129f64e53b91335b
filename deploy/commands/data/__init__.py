"""Commands on logs and other tools' formats."""
