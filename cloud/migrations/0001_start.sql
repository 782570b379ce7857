-- Times are in seconds since 1970, digests are hexadecimal digits, and truth values are 0 or 1.
-- Only what SQLite and PostgreSQL both accept: TEXT and BIGINT.

CREATE TABLE users (
    name TEXT PRIMARY KEY,
    role TEXT NOT NULL
);

-- One-time codes and tokens of users, and one-time tokens of vehicles, by their SHA-256.
CREATE TABLE secrets (
    hash TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    subject TEXT NOT NULL,
    expires BIGINT NOT NULL
);
CREATE INDEX secrets_of ON secrets (kind, subject);

CREATE TABLE vehicles (
    name TEXT PRIMARY KEY,
    is_revoked BIGINT NOT NULL DEFAULT 0,
    epoch BIGINT NOT NULL DEFAULT 0,
    seen BIGINT NOT NULL DEFAULT 0,
    version TEXT NOT NULL DEFAULT '',
    clip_key TEXT NOT NULL DEFAULT '',
    labels TEXT NOT NULL DEFAULT '{}',
    generation BIGINT NOT NULL DEFAULT 0,
    digest TEXT NOT NULL DEFAULT '',
    handled BIGINT NOT NULL DEFAULT 0,
    problems TEXT NOT NULL DEFAULT '[]',
    status TEXT NOT NULL DEFAULT '',
    deployments BIGINT NOT NULL DEFAULT 0,
    running BIGINT NOT NULL DEFAULT 0,
    arrived BIGINT NOT NULL DEFAULT 0
);

CREATE TABLE certificates (
    sha256 TEXT PRIMARY KEY,
    vehicle TEXT NOT NULL REFERENCES vehicles (name),
    expires BIGINT NOT NULL
);
CREATE INDEX certificates_of ON certificates (vehicle);

CREATE TABLE revisions (
    digest TEXT PRIMARY KEY,
    envelope TEXT NOT NULL
);

CREATE TABLE deployments (
    id TEXT PRIMARY KEY,
    number BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    envelope TEXT NOT NULL,
    revision TEXT NOT NULL REFERENCES revisions (digest),
    fallback TEXT NOT NULL,
    grants TEXT NOT NULL,
    selector TEXT NOT NULL,
    is_wanted BIGINT NOT NULL,
    rollback_request BIGINT NOT NULL
);

-- The state of each deployment that a vehicle has reported.
CREATE TABLE reported (
    vehicle TEXT NOT NULL REFERENCES vehicles (name),
    deployment TEXT NOT NULL,
    number BIGINT NOT NULL,
    state TEXT NOT NULL,
    PRIMARY KEY (vehicle, deployment)
);

-- The last durable record of each stream, and what was removed of it to make room.
CREATE TABLE streams (
    vehicle TEXT NOT NULL REFERENCES vehicles (name),
    stream TEXT NOT NULL,
    life BIGINT NOT NULL,
    next BIGINT NOT NULL,
    seq BIGINT NOT NULL,
    boot TEXT NOT NULL,
    boot_ns BIGINT NOT NULL,
    kept BIGINT NOT NULL DEFAULT 0,
    kept_bytes BIGINT NOT NULL DEFAULT 0,
    removed BIGINT NOT NULL DEFAULT 0,
    removed_to BIGINT NOT NULL DEFAULT 0,
    PRIMARY KEY (vehicle, stream)
);

-- `mark` is empty for records. Gaps and damage share numbers with records: theirs is the SHA-256
-- of the line.
CREATE TABLE records (
    vehicle TEXT NOT NULL REFERENCES vehicles (name),
    stream TEXT NOT NULL,
    life BIGINT NOT NULL,
    seq BIGINT NOT NULL,
    mark TEXT NOT NULL,
    arrival BIGINT NOT NULL,
    line TEXT NOT NULL,
    bytes BIGINT NOT NULL,
    PRIMARY KEY (vehicle, stream, life, seq, mark)
);
CREATE INDEX records_by_arrival ON records (vehicle, stream, arrival);

CREATE TABLE audit (
    seq BIGINT PRIMARY KEY,
    time_ms BIGINT NOT NULL,
    actor TEXT NOT NULL,
    action TEXT NOT NULL,
    subject TEXT NOT NULL,
    hash TEXT NOT NULL
);
