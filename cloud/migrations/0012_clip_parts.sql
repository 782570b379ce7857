-- SHA-256 of each part of a file, as it was acknowledged: in a bucket, it is in the name of the part.
CREATE TABLE clip_parts (
    clip BIGINT NOT NULL REFERENCES clips (seq) ON DELETE CASCADE,
    part BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (clip, part)
);
