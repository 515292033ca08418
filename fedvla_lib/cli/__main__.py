"""``python -m fedvla_lib.cli`` is the command `fedvla`."""

import sys

from fedvla_lib.cli.main import main

sys.exit(main())
