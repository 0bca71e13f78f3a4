"""Research beside the product: the tables of the thesis, and the blind study of the diagnosis."""
