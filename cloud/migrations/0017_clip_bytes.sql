-- Bytes of each file, and of each part of one, that are stored: parts have any length.
ALTER TABLE clips ADD COLUMN received BIGINT NOT NULL DEFAULT 0;
UPDATE clips SET received = CASE WHEN parts * 8388608 > bytes THEN bytes ELSE parts * 8388608 END;
ALTER TABLE clip_parts ADD COLUMN bytes BIGINT NOT NULL DEFAULT 0;
UPDATE clip_parts SET bytes = COALESCE((SELECT
    CASE WHEN (clip_parts.part + 1) * 8388608 > clips.bytes
    THEN clips.bytes - clip_parts.part * 8388608 ELSE 8388608 END
    FROM clips WHERE clips.seq = clip_parts.clip), 0);

-- Bytes that a clip has on the disk beside its file: its entry, and its thumbnail, whose length was
-- not noted before.
ALTER TABLE clips ADD COLUMN disk BIGINT NOT NULL DEFAULT 4096;
UPDATE clips SET disk = 4096 + LENGTH(facts) + has_thumbnail * 65536;
-- Bytes of files that are still to be removed.
ALTER TABLE removed_clips ADD COLUMN bytes BIGINT NOT NULL DEFAULT 0;
-- All of these of a vehicle, with the announced bytes of each file of which some are stored.
ALTER TABLE clip_vehicles ADD COLUMN disk BIGINT NOT NULL DEFAULT 0;
INSERT INTO clip_vehicles (vehicle) SELECT DISTINCT vehicle FROM clips WHERE seq > 0
    ON CONFLICT (vehicle) DO NOTHING;
UPDATE clip_vehicles SET disk = CAST(COALESCE((SELECT
    SUM(clips.disk + CASE WHEN clips.parts > 0 THEN clips.bytes ELSE 0 END)
    FROM clips WHERE clips.vehicle = clip_vehicles.vehicle), 0) AS BIGINT);
DROP INDEX clips_with_bytes;
CREATE INDEX clips_on_disk ON clips (vehicle, parts, bytes, disk);
