"""`python -m wavebatch`."""

from wavebatch.cli import main

if __name__ == "__main__":
    main()
