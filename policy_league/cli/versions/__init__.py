"""Commands about versions and aliases."""
