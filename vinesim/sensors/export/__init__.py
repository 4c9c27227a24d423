"""Files of pictures and annotations, and data sets."""
