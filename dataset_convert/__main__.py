"""`python -m dataset_convert` is `lansar-convert`."""

import sys

from dataset_convert.convert import main

sys.exit(main())
