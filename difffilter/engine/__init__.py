"""The fused engine: the torch step traced once, lowered to scalar C, compiled and cached."""
