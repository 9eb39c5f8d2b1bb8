"""Print the oldest versions that pyproject.toml allows, as constraints for pip."""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
for wanted in [*project["dependencies"], *project["optional-dependencies"]["test"]]:
    name, version = re.match(r"([\w-]+)>=([\d.]+)", wanted).groups()
    print(f"{name}=={version}")
