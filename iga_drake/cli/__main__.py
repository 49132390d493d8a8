"""`python -m iga_drake.cli` is `iga`; torchrun starts trainings by it."""

import sys

from iga_drake.cli import main

sys.exit(main())
