"""`python train.py --help`, or `python -m mjx_dher --help`"""

import sys

from mjx_dher.system import signals


def main() -> int:
    """Runs the command line. The signals come first: what it imports takes seconds, and much of it is written in C."""
    signals.take()
    from mjx_dher import cli

    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
