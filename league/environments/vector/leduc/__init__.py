"""Leduc hold'em of RLCard: random generators, deals, rules, and tables of all situations."""
