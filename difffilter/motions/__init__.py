"""How a state moves, and the noise that comes in: the protocol, blocks, a user's own."""
