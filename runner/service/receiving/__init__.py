"""What becomes of an upload, from its announcement to a run; no HTTP in it.

model      what an upload is, and where it stands; what a client says of it
appending  the bytes of one request, written
folder     uploads on disk: what each is, its bytes so far
verifying  the process that verifies one
uploads    what may be done with an upload when, and by whom
"""
