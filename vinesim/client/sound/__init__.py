"""Sound in a client: from pages and loudspeakers to the network, and from there to pages and microphones."""
