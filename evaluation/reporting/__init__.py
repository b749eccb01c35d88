"""Reports of a league: HTML page, JSON document, charts and webhook."""
