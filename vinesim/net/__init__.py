"""Who hears what and who owns what; messages, buses and the server that only carries them."""
