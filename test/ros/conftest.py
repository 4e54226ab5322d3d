"""Real ROS with checked message fields, seen by this machine only, in a domain of this run."""

import os

os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
