-- Clips of vehicles. `state` is the place of the file: `vehicle`, `stored`, `gone` or `failed`;
-- `parts` counts those of its parts that are stored. `sha256` and `thumbnail` are empty without
-- one. `score` is in millionths.
CREATE TABLE clips (
    seq BIGINT PRIMARY KEY,
    vehicle TEXT NOT NULL REFERENCES vehicles (name),
    name TEXT NOT NULL,
    facts TEXT NOT NULL,
    from_ns BIGINT NOT NULL,
    to_ns BIGINT NOT NULL,
    bytes BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    thumbnail TEXT NOT NULL,
    has_thumbnail BIGINT NOT NULL DEFAULT 0,
    score BIGINT NOT NULL,
    is_requested BIGINT NOT NULL DEFAULT 0,
    state TEXT NOT NULL,
    reason TEXT NOT NULL DEFAULT '',
    parts BIGINT NOT NULL DEFAULT 0,
    part_time BIGINT NOT NULL DEFAULT 0,
    failures BIGINT NOT NULL DEFAULT 0,
    UNIQUE (vehicle, name)
);
CREATE INDEX clips_by_state ON clips (vehicle, state);
CREATE INDEX clips_with_bytes ON clips (vehicle, bytes) WHERE parts > 0;

-- Lambdas and labels of each clip: `kind` is `lambda` or `label`.
CREATE TABLE clip_words (
    kind TEXT NOT NULL,
    word TEXT NOT NULL,
    clip BIGINT NOT NULL REFERENCES clips (seq),
    PRIMARY KEY (kind, word, clip)
);
CREATE INDEX clip_words_of ON clip_words (clip);

-- The position of each vehicle in its list of clips, and the bytes that it has sent on a day,
-- which is a number of days since 1970.
CREATE TABLE clip_vehicles (
    vehicle TEXT PRIMARY KEY REFERENCES vehicles (name),
    position TEXT NOT NULL DEFAULT '',
    day BIGINT NOT NULL DEFAULT 0,
    day_bytes BIGINT NOT NULL DEFAULT 0
);

CREATE TABLE clip_policy (
    upload TEXT NOT NULL,
    day_bytes BIGINT NOT NULL
);
INSERT INTO clip_policy (upload, day_bytes) VALUES ('on-demand', 2147483648);
