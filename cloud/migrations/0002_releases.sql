-- Releases of deployments. A vehicle should have the newest one that is open to it: `complete` ones
-- are open to all vehicles that they select, others to those that their waves have reached.
-- States are `running`, `paused`, `aborted` and `complete`. A complete one has no older ones.
CREATE TABLE releases (
    deployment TEXT NOT NULL,
    number BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    envelope TEXT NOT NULL,
    revision TEXT NOT NULL REFERENCES revisions (digest),
    fallback TEXT NOT NULL,
    grants TEXT NOT NULL,
    selector TEXT NOT NULL,
    rollback_request BIGINT NOT NULL,
    state TEXT NOT NULL,
    plan TEXT NOT NULL DEFAULT '',
    wave BIGINT NOT NULL DEFAULT 0,
    since BIGINT NOT NULL DEFAULT 0,
    reason TEXT NOT NULL DEFAULT '',
    PRIMARY KEY (deployment, number)
);
CREATE INDEX releases_by_sha256 ON releases (sha256);
INSERT INTO releases (deployment, number, sha256, envelope, revision, fallback, grants, selector,
    rollback_request, state)
SELECT id, number, sha256, envelope, revision, fallback, grants, selector, rollback_request,
    'complete' FROM deployments;

CREATE TABLE wanted_deployments (
    id TEXT PRIMARY KEY,
    is_wanted BIGINT NOT NULL
);
INSERT INTO wanted_deployments (id, is_wanted) SELECT id, is_wanted FROM deployments;
DROP TABLE deployments;
ALTER TABLE wanted_deployments RENAME TO deployments;

-- SHA-256 of the certificate that signs the cloud's, of the folder that the database belongs to.
CREATE TABLE folder (
    authority TEXT NOT NULL
);

-- The vehicles that the waves of a release have reached. `is_forgiven` is 1 of those that had
-- failed when a person let the waves go on.
CREATE TABLE wave_members (
    vehicle TEXT NOT NULL REFERENCES vehicles (name),
    deployment TEXT NOT NULL,
    number BIGINT NOT NULL,
    is_forgiven BIGINT NOT NULL DEFAULT 0,
    PRIMARY KEY (deployment, number, vehicle)
);
CREATE INDEX wave_members_by_vehicle ON wave_members (vehicle);
