"""What a robot of a client does: tasks, their planning, start poses."""
