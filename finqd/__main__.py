"""``python -m finqd`` is ``finqd``."""

from finqd.cli import main

if __name__ == "__main__":
    main()
