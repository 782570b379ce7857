-- Processes that serve this database, each with the end of its lease. `vehicles.replica` is the one
-- with the vehicle's newest connection; empty without one.
CREATE TABLE replicas (
    id TEXT PRIMARY KEY,
    until BIGINT NOT NULL
);
ALTER TABLE vehicles ADD COLUMN replica TEXT NOT NULL DEFAULT '';
CREATE INDEX vehicles_by_replica ON vehicles (replica);

-- The place of files, `s3://BUCKET/PREFIX`; empty if it is the folder.
ALTER TABLE folder ADD COLUMN objects TEXT NOT NULL DEFAULT '';

-- Files that offered deployments wait for.
CREATE TABLE awaited_files (
    deployment TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    bytes BIGINT NOT NULL,
    time BIGINT NOT NULL,
    PRIMARY KEY (deployment, sha256)
);
CREATE INDEX awaited_files_by_sha256 ON awaited_files (sha256);
