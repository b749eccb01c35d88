"""A cluster of several machines on one: network namespaces with Ray, PostgreSQL and Redis."""
