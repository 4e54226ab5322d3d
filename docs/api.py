"""Write the pages of the Python interface from its docstrings: python docs/api.py FOLDER."""

import sys
import warnings
from pathlib import Path

import pdoc

import cello3d_ros

# fields of named tuples are annotated by names of the modules that define them
warnings.filterwarnings("ignore", "Error parsing type annotation")
for name in cello3d_ros.__all__:  # they are imported when they are first used
    vars(cello3d_ros)[name] = getattr(cello3d_ros, name)
pdoc.render.configure(docformat="markdown", show_source=False)
pdoc.pdoc("cello3d_ros", "!cello3d_ros.", output_directory=Path(sys.argv[1]))
print(f"{sys.argv[1]}/index.html")
