"""A module a command; each has it as `command` and imports at its top only what is light."""
