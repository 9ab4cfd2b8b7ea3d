"""The command line. Modules import the library within commands, so that help is quick."""
