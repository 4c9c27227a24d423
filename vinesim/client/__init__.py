"""A client: receive, control, step, sense, send. The only place where neighbouring rooms meet."""
