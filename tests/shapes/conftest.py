"""Makes the checks beside this file importable from the folders below."""
