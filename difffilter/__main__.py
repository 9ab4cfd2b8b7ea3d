"""``python -m difffilter``."""

from difffilter.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
