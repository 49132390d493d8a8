"""IGA-Drake: few-shot manipulation of unseen objects as a Drake system."""

__version__ = "0.1.0"
