"""`python -m causticmpi.peers`, which `scripts/peers` calls."""

from causticmpi.peers.run import main

raise SystemExit(main())
