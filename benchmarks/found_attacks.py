"""Pack what a published board's searches found into the package, for the ensemble's member `transfer`.

    python benchmarks/found_attacks.py quick-v1 radar-v1 ...

Run it from the folder of the repository, where the files of the attacks are.
"""

from __future__ import annotations

import argparse
import json
import lzma
from pathlib import Path

from tailgate.base.files import write_atomic
from tailgate.base.reading import load_json
from tailgate.ensemble.published import FOLDER, packed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("boards", nargs="+", metavar="BOARD", help="a folder of results")
    for name in parser.parse_args().boards:
        held = packed(load_json(Path("results") / name / "board.json.xz"), Path())
        content = lzma.compress(json.dumps(held, indent=0).encode() + b"\n")
        FOLDER.mkdir(exist_ok=True)
        write_atomic(FOLDER / f"{name}.json.xz", content)
        print(f"{name}: {len(held['attacks'])} attacks, {len(held['files'])} files, {len(content):,} bytes")


if __name__ == "__main__":
    main()
