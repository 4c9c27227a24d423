"""A client: receive, control, step, sense, send. It composes the packages that do not import each other."""
