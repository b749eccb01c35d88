# Generated from league/client/_async/__init__.py by scripts/generate_sync_client.py; do not edit.
"""The blocking client."""
