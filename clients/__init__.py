"""Programs that are clients of the server or read recordings."""
