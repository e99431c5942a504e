"""`python -m mjx_arm`: the command line."""

import sys

from mjx_arm.cli import main

sys.exit(main())
