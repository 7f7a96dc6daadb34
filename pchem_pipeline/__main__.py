"""The command ``pchem`` as ``python -m pchem_pipeline``."""

from pchem_pipeline.cli.app import main

if __name__ == "__main__":
    main()
