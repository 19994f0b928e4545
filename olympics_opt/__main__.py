import sys

from olympics_opt.cli import main

if __name__ == "__main__":
    sys.exit(main())
