"""People: bodies, hands, haptics, and a scripted person for tests and demonstrations."""
