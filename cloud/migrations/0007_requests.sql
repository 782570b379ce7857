-- Requests with a key that have created something, by their users: a repetition gets `answer`, which
-- is empty if it had a secret. `request` is the SHA-256 of the request.
CREATE TABLE request_keys (
    actor TEXT NOT NULL,
    name TEXT NOT NULL,
    request TEXT NOT NULL,
    answer TEXT NOT NULL DEFAULT '',
    time BIGINT NOT NULL,
    PRIMARY KEY (actor, name)
);
CREATE INDEX request_keys_by_time ON request_keys (time);
