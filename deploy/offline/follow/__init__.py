"""Following people and vehicles offline: input of any kind, checks, and the files that `syncline follow` writes."""
