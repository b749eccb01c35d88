"""Commands about whole leagues: create, list, archive and remove them, and compare their training runs."""
