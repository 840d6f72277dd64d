"""``python -m terrafix``: the command line."""

from terrafix.cli import main

if __name__ == "__main__":
    main(prog_name="terrafix")
