"""`python -m labelgen`: the command where its script is not on the path."""

from labelgen.cli.main import main

if __name__ == "__main__":
    main()
