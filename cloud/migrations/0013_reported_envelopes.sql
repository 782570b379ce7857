-- The state of each deployment that a vehicle has or refuses, by the SHA-256 of its signed envelope:
-- of one release there may be several. Vehicles report it again with their next connection. Rows
-- with the state `removed` have the last number of a deployment that is gone, and no envelope.
DROP TABLE reported;
CREATE TABLE reported (
    vehicle TEXT NOT NULL REFERENCES vehicles (name),
    deployment TEXT NOT NULL,
    envelope TEXT NOT NULL,
    number BIGINT NOT NULL,
    state TEXT NOT NULL,
    reason TEXT NOT NULL,
    PRIMARY KEY (vehicle, deployment, envelope)
);

-- 1 of a vehicle that has followed a newer state than a database that was restored from a backup.
ALTER TABLE vehicles ADD COLUMN is_ahead BIGINT NOT NULL DEFAULT 0;

-- Time at which a vehicle reported its status, in ms since 1970.
ALTER TABLE vehicles ADD COLUMN reported_ms BIGINT NOT NULL DEFAULT 0;

-- The boot of the machine that is connected, and of the one before, and the number of times that a
-- former boot has come back: from 2 on, two machines have the identity of the vehicle.
ALTER TABLE vehicles ADD COLUMN boot TEXT NOT NULL DEFAULT '';
ALTER TABLE vehicles ADD COLUMN former_boot TEXT NOT NULL DEFAULT '';
ALTER TABLE vehicles ADD COLUMN is_double BIGINT NOT NULL DEFAULT 0;

UPDATE vehicles SET reported_ms = seen * 1000;

-- The newest wanted state that was sent to the vehicle: one that has followed a newer one is ahead.
ALTER TABLE vehicles ADD COLUMN offered BIGINT NOT NULL DEFAULT 0;
UPDATE vehicles SET offered = generation;
