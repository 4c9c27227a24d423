"""The public Python interface: what ``import vinesim`` offers, composed of the packages below."""
