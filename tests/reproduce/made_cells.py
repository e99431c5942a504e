"""What tests of the page put into its cells."""

MACHINE = {
    "cpu": "a processor",
    "cores": 2,
    "device": "cpu",
    "python": "3.11",
    "xla_flags": "",
    "versions": {"jax": "0.10"},
}
