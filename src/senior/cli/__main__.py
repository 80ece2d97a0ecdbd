import sys

from senior.cli import main

sys.exit(main())
