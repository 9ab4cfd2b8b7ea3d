"""What a measurement should read: the protocol, built-in sensors, a user's own."""
