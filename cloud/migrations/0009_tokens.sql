-- Tokens that users make for programs have a name, and at most the role that the user has.
ALTER TABLE secrets ADD COLUMN name TEXT NOT NULL DEFAULT '';
ALTER TABLE secrets ADD COLUMN role TEXT NOT NULL DEFAULT '';
CREATE UNIQUE INDEX secrets_named ON secrets (subject, name) WHERE name <> '';
