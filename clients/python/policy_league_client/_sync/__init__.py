# Generated from clients/python/policy_league_client/_async/__init__.py by scripts/generate_sync_client.py; do not edit.
"""The blocking client."""
