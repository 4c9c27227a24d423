"""``vinesim doctor``: checks the requirements of vinesim on this machine; one line for each, with a remedy."""
