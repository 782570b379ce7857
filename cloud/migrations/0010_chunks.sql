-- Records that were moved into files, each of many that follow one another in a stream. `bytes` are
-- those of the lines, and `stored_bytes` those of the file. `level` is the highest of a line: 0
-- without one, 5 for an error. Times are those of vehicles, in ns since 1970; 0 without one.
CREATE TABLE chunks (
    vehicle TEXT NOT NULL REFERENCES vehicles (name),
    stream TEXT NOT NULL,
    first_arrival BIGINT NOT NULL,
    last_arrival BIGINT NOT NULL,
    first_seq BIGINT NOT NULL,
    last_seq BIGINT NOT NULL,
    first_time BIGINT NOT NULL,
    last_time BIGINT NOT NULL,
    level BIGINT NOT NULL,
    records BIGINT NOT NULL,
    bytes BIGINT NOT NULL,
    stored_bytes BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (vehicle, stream, last_arrival)
);
ALTER TABLE streams ADD COLUMN packed BIGINT NOT NULL DEFAULT 0;
ALTER TABLE streams ADD COLUMN packed_bytes BIGINT NOT NULL DEFAULT 0;

-- Files of chunks that no row of `chunks` names: of those that are being made since then, and with
-- 0 those to remove.
CREATE TABLE chunk_files (
    sha256 TEXT PRIMARY KEY,
    since BIGINT NOT NULL
);

-- The last arrival of a vehicle before a day, in days since 1970: older ones are at least that old.
CREATE TABLE arrival_days (
    vehicle TEXT NOT NULL REFERENCES vehicles (name),
    day BIGINT NOT NULL,
    arrived BIGINT NOT NULL,
    PRIMARY KEY (vehicle, day)
);
CREATE INDEX arrival_days_by_day ON arrival_days (day);
