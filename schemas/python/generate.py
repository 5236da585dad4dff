#!/usr/bin/env python3
"""Compiles ../*.proto to Python in FOLDER; default: `generated` beside this file.

    pip install grpcio-tools
    python generate.py [FOLDER]
"""

import argparse
import pathlib
import sys

from grpc_tools import protoc

HERE = pathlib.Path(__file__).resolve().parent


def main() -> int:
    parser = argparse.ArgumentParser(description="Compiles the messages of the bus to Python.")
    parser.add_argument("folder", nargs="?", type=pathlib.Path, default=HERE / "generated")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    schemas = HERE.parent
    files = sorted(str(path) for path in schemas.glob("*.proto"))
    return protoc.main(["protoc", f"-I{schemas}", f"--python_out={folder}", *files])


if __name__ == "__main__":
    sys.exit(main())
