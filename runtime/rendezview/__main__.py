"""``python -m rendezview``: the command, where its script is not on the path."""

from rendezview.cli.main import main

main()
