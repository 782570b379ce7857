-- The hash of a user's password for the page, in the PHC format; empty without one.
ALTER TABLE users ADD COLUMN password TEXT NOT NULL DEFAULT '';
