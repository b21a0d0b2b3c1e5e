"""What a mechanism file says: structs, reading and checking, random draws of what is uncertain."""
