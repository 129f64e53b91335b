"""Commands that install, diagnose and administer machines and sites."""
