"""The public Python interface of ``import vinesim``, composed of the packages below."""
