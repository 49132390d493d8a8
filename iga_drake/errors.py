"""The base of every error that this package raises on purpose."""


class IgaDrakeError(Exception):
    """Bad input or a refused operation; the message names what was found and what to do."""
