"""``vinesim doctor``: what vinesim needs of this machine, each thing in one line with its remedy."""
