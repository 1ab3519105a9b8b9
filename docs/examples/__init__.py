"""Programs of the documentation: small, complete, and run by tests."""
