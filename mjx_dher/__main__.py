"""`python train.py --help`, or `python -m mjx_dher --help`"""

import signal
import sys

from mjx_dher.system import signals


def main() -> int:
    """Runs the command line. Signal handling comes first, because imports take seconds."""
    signals.take()
    # The thread that reads them gets Ctrl-C. Programs that libraries start, as glfw does, inherit the mask, and keep quiet.
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    from mjx_dher import cli

    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
