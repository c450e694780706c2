"""`python -m gateway.cli` is `mavgate`."""

from gateway.cli.app import main

main()
