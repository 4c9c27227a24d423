"""What the pages of a client show and hear, who may open them, and recordings on a page."""
