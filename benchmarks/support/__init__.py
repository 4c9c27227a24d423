"""Load generators and link emulation for benchmarks and tests; not part of the wheel."""
