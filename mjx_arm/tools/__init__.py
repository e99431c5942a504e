"""Tools around runs and agents: listing, comparing, searching for options. Nothing imports them."""
