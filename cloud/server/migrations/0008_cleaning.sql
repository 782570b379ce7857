-- Number of the request to start the lambda of a release again, also after a quarantine.
ALTER TABLE releases ADD COLUMN start_request BIGINT NOT NULL DEFAULT 0;

-- Time from which no release has needed a revision; 0 while one does.
ALTER TABLE revisions ADD COLUMN unused_since BIGINT NOT NULL DEFAULT 0;

-- Time at which the file of a clip was stored, and the policy for how long and how many are kept;
-- 0 is without a bound. What was removed is counted for people.
ALTER TABLE clips ADD COLUMN stored_time BIGINT NOT NULL DEFAULT 0;
UPDATE clips SET stored_time = part_time WHERE state = 'stored';
ALTER TABLE clip_policy ADD COLUMN keep_days BIGINT NOT NULL DEFAULT 0;
ALTER TABLE clip_policy ADD COLUMN keep_bytes BIGINT NOT NULL DEFAULT 0;
ALTER TABLE clip_policy ADD COLUMN removed BIGINT NOT NULL DEFAULT 0;
ALTER TABLE clip_policy ADD COLUMN removed_bytes BIGINT NOT NULL DEFAULT 0;
