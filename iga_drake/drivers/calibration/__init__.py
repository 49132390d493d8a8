"""Where cameras stand: measured with a board, and checked with the arm's own shape."""
