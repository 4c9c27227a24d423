"""Pages of a client (the browser tabs in which people see its vineyard): picture, sound, access from other machines,
and recordings."""
