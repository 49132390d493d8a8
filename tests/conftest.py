"""Its place puts `tests/` on the import path, for the modules that tests share."""

import os

from hypothesis import HealthCheck, settings
from hypothesis.database import DirectoryBasedExampleDatabase

# Property tests: the same few inputs every time.
settings.register_profile(
    "test",
    max_examples=30,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
# `make fuzz`: many inputs, which follow from the seed; what failed is tried first the next time.
settings.register_profile(
    "fuzz",
    settings.get_profile("test"),
    max_examples=int(os.environ.get("FUZZ_INPUTS", "2000")),
    derandomize=False,
    database=DirectoryBasedExampleDatabase("outputs/fuzz"),
    print_blob=True,
)
settings.load_profile("fuzz" if "FUZZ_INPUTS" in os.environ else "test")
