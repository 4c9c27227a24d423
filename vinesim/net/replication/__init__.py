"""Interest, authority, dead reckoning and retained state: which client sends what to whom."""
