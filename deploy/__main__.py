"""`python -m deploy` runs the `syncline` command, so that a process can start others without searching PATH."""

from deploy.cli import main

if __name__ == "__main__":
    main()
