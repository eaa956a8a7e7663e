"""`python train.py --help`"""

import sys

from mjx_dher.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
