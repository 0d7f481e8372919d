"""The commands, a module for each subject: `NAME_command` is the command NAME, and imports heavy packages."""
