"""Write the JSON Schemas and the tables of the pages: `python docs/file_formats`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from file_formats.pages import written

for path, text in written().items():
    path.write_text(text, encoding='utf-8')
    print(path)
