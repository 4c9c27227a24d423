"""Pictures and annotations as files, data sets."""
