"""A filter over a log, over a stream, and the loss with its derivatives."""
