"""Its place puts `tests/` on the import path, for the modules that tests share."""

from hypothesis import HealthCheck, settings

# Property tests: the same few inputs every time.
settings.register_profile(
    "test",
    max_examples=30,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("test")
