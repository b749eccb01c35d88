"""Import of models that were trained elsewhere, as versions of a league."""
