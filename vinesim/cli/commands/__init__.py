"""Options of every command; a command imports its implementation when it runs, so that ``--help`` opens at once."""
