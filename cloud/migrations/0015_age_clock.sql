-- The clock by which records and clips age, in s: the time that processes have measured. `wall` is
-- the time of the machine at the last look, in s since 1970.
CREATE TABLE age_clock (
    seconds BIGINT NOT NULL,
    wall BIGINT NOT NULL
);

-- For the metrics: rows of vehicles have their statuses, which are long.
CREATE INDEX vehicles_by_state ON vehicles (replica, is_revoked, epoch);
DROP INDEX vehicles_by_replica;
CREATE INDEX stored_clip_bytes ON clips (bytes) WHERE state = 'stored';
