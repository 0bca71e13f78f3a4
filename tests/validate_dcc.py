"""Validate Digital Calibration Certificates against the schemas of the PTB: DCC 3.2.1 and D-SI 2.1.0.

    pip install xmlschema
    python tests/validate_dcc.py results/my_bench/certificates/*.xml

reads the schemas from www.ptb.de, or from the folder that --schemas names (dcc.xsd, SI_Format.xsd and
xmldsig-core-schema.xsd). They are under the LGPL and not part of this repository.
"""

import argparse
import sys
from pathlib import Path

SOURCE = "https://www.ptb.de/dcc/v3.2.1/dcc.xsd"
IMPORTED = {"https://ptb.de/si": "SI_Format.xsd", "http://www.w3.org/2000/09/xmldsig#": "xmldsig-core-schema.xsd"}


def main() -> int:
    import xmlschema  # noqa: PLC0415  (not needed by any test)

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--schemas", type=Path, help="folder with the schemas")
    given = parser.parse_args()
    folder = given.schemas and given.schemas.resolve()
    locations = {space: str(folder / name) for space, name in IMPORTED.items()} if folder else None
    schema = xmlschema.XMLSchema(str(folder / "dcc.xsd") if folder else SOURCE, locations=locations)
    faults = 0
    for file in given.files:
        errors = [f"{e.path}: {e.reason}" for e in schema.iter_errors(str(file))]
        print(f"{file}: {'valid' if not errors else f'{len(errors)} faults'}", *errors, sep="\n  ")
        faults += len(errors)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
