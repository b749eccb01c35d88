"""The asyncio client; the blocking client, `_sync`, is generated from it."""
