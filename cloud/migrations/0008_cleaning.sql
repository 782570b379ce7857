-- Number of the request to start the lambda of a release again, also after a quarantine.
ALTER TABLE releases ADD COLUMN start_request BIGINT NOT NULL DEFAULT 0;

-- Time since which no release has needed a revision; 0 while one does.
ALTER TABLE revisions ADD COLUMN unused_since BIGINT NOT NULL DEFAULT 0;

-- Bounds of what is kept of the files of clips; 0 is without one. What was removed is counted.
ALTER TABLE clip_policy ADD COLUMN keep_s BIGINT NOT NULL DEFAULT 0;
ALTER TABLE clip_policy ADD COLUMN keep_bytes BIGINT NOT NULL DEFAULT 0;
ALTER TABLE clip_policy ADD COLUMN removed BIGINT NOT NULL DEFAULT 0;
ALTER TABLE clip_policy ADD COLUMN removed_bytes BIGINT NOT NULL DEFAULT 0;
CREATE INDEX stored_clips ON clips (part_time, seq) WHERE state = 'stored';

-- Clips that were removed, until their files are, too.
CREATE TABLE removed_clips (
    vehicle TEXT NOT NULL,
    name TEXT NOT NULL,
    PRIMARY KEY (vehicle, name)
);
