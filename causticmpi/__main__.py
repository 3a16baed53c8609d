"""`python -m causticmpi` is the same program as `causticmpi`."""

from causticmpi.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
