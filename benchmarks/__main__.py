"""`python -m benchmarks [--quick] [--out FILE]`: first calls in fresh processes, then speeds in one process.

`--out docs/speed.md` puts the tables between the page's two marks.
"""

import argparse
import os
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)

from benchmarks import first_calls, speed  # noqa: E402 - after JAX is configured

BEGIN, END = "<!-- measured -->", "<!-- until here -->"

parser = argparse.ArgumentParser(description="First calls; speed of gradients, exact evaluation and stable points.")
parser.add_argument("--quick", action="store_true", help="the small shapes only")
parser.add_argument("--out", type=Path, help="also write the tables as Markdown, in a page with marks between these")
arguments = parser.parse_args()
text = first_calls.table() + "\n\n" + speed.table(arguments.quick)
print(text)
if arguments.out is not None:
    page = arguments.out.read_text(encoding="utf-8") if arguments.out.exists() else ""
    if BEGIN in page:
        before, after = page.split(BEGIN)[0], page.split(END)[1]
        text = f"{before}{BEGIN}\n\n{text}\n\n{END}{after.rstrip()}"
    arguments.out.write_text(text + "\n", encoding="utf-8")
