"""The notebooks are executed by the tests, each in a kernel of its own, with few trials."""

import os

os.environ["JAXNAV_FAST"] = "1"
