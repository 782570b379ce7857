-- Streams that people read as records come, until a time in s since 1970: their vehicles send these
-- at once.
CREATE TABLE tails (
    vehicle TEXT NOT NULL,
    stream TEXT NOT NULL,
    until BIGINT NOT NULL,
    PRIMARY KEY (vehicle, stream)
);
CREATE INDEX tails_by_until ON tails (until);
