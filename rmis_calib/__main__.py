"""`python -m rmis_calib`, the same as `rmis-calib`."""

import sys

from rmis_calib.cli import main

sys.exit(main())
