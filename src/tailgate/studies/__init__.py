"""How strong an attack is: what its timing is worth, what a dose does, what carries over to other defences, and the zoo's records."""
