"""Codecs of requests and responses: observations, binary leaves and state tokens."""
