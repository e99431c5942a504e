"""Tools around runs and agents: listing, comparing, searching for options.

Only the command line and a user's own programs import them.
"""
