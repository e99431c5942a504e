"""The paper on one page: every table and figure, measured by one command."""
