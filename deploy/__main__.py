"""`python -m deploy` is the `syncline` command, so that a process can start others without a PATH."""

from deploy.cli import main

if __name__ == "__main__":
    main()
