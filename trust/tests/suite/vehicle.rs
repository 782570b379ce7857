//! Scopes, releases that go back, expiry, clocks that jump, and new trust roots.

use gleaner_base::Explain;
use gleaner_lambda::manifest::Sha256;
use gleaner_trust::{Deployment, Refusal, Revision, Trusted, Verdict, first_root, next_root};

use super::*;

/// The time at which the vehicle's program was built.
const BUILT: u64 = SIGNED - 100 * DAY;

struct TestVehicle {
    root: TrustRoot,
    floors: Floors,
    labels: Labels,
    now: u64,
    known: Vec<Sha256>,
}

impl TestVehicle {
    fn new() -> Self {
        let mut floors = Floors::default();
        floors.accept_root(&root(), BUILT);
        Self { root: root(), floors, labels: Labels::new(), now: SIGNED, known: Vec::new() }
    }

    fn verifier(&self) -> Verifier<'_> {
        let Self { root, floors, labels, now, known } = self;
        Verifier { root, floors, labels, now: *now, known }
    }

    /// Verifies both, and accepts them.
    fn accept(&mut self, deployment: &Deployment, revision: &[u8]) -> Result<Verdict, Refusal> {
        let envelope = seal(deployment, &[&key(DEPLOYER)]).unwrap();
        let verifier = self.verifier();
        let revision = verifier.revision(revision)?;
        let deployment = verifier.deployment(&envelope)?;
        let verdict = verifier.admit(&deployment, &revision, None)?;
        self.floors.accept(&deployment, &revision, BUILT)?;
        // A state survives a restart.
        self.floors = Floors::parse(&self.floors.to_json()).unwrap();
        Ok(verdict)
    }
}

#[test]
fn a_lower_release_and_another_one_with_the_same_number_are_refused() {
    let mut vehicle = TestVehicle::new();
    let [old, new] = [1, 2].map(signed_revision);
    assert_eq!(vehicle.accept(&deployment(5, &new), &new), Ok(Verdict::Current));
    assert_eq!(vehicle.accept(&deployment(5, &new), &new), Ok(Verdict::Current));
    assert_eq!(
        vehicle.accept(&deployment(4, &new), &new),
        Err(Refusal::RolledBack { what: "deployment `front`".to_owned(), found: 4, floor: 5 })
    );
    let mut other = deployment(5, &new);
    other.expires += 1;
    assert!(matches!(vehicle.accept(&other, &new), Err(Refusal::SameRelease { .. })));
    // A new deployment cannot bring back an old revision, under another name neither.
    let mut back = deployment(6, &old);
    let lambda = || "lambda `brake-dark`".to_owned();
    let refusal = Err(Refusal::RolledBack { what: lambda(), found: 1, floor: 2 });
    assert_eq!(vehicle.accept(&back, &old), refusal);
    back.id = "rear".parse().unwrap();
    assert_eq!(vehicle.accept(&back, &old), refusal);
    let mut changed = revision(2);
    changed.files.clear();
    let changed = seal(&changed, &[&key(PUBLISHER)]).unwrap();
    let refusal = vehicle.accept(&deployment(6, &changed), &changed).unwrap_err();
    assert!(matches!(&refusal, Refusal::SameRelease { what, .. } if *what == lambda()));
}

#[test]
fn a_newer_release_in_one_deployment_does_not_stop_another() {
    let mut vehicle = TestVehicle::new();
    let [old, new] = [1, 2].map(signed_revision);
    let front = deployment(1, &old);
    vehicle.accept(&front, &old).unwrap();
    let mut rear = deployment(1, &new);
    rear.id = "rear".parse().unwrap();
    vehicle.accept(&rear, &new).unwrap();
    assert_eq!(vehicle.accept(&front, &old), Ok(Verdict::Current));
}

#[test]
fn an_older_fallback_is_allowed_and_must_be_the_one_that_is_named() {
    let vehicle = TestVehicle::new();
    let [old, new, third] = [1, 2, 3].map(signed_revision);
    let verifier = vehicle.verifier();
    let [old, new_one, third] = [&old, &new, &third].map(|it| verifier.revision(it).unwrap());
    let mut wish = deployment(1, &new);
    wish.fallback = Some(old.digest().clone());
    let wish = verifier.deployment(&seal(&wish, &[&key(DEPLOYER)]).unwrap()).unwrap();
    let admit = |revision: &Trusted<Revision>, fallback: Option<&Trusted<Revision>>| {
        verifier.admit(&wish, revision, fallback)
    };
    assert_eq!(admit(&new_one, Some(&old)), Ok(Verdict::Current));
    for (revision, fallback) in
        [(&third, Some(&old)), (&new_one, Some(&third)), (&new_one, None), (&old, Some(&new_one))]
    {
        let refusal = admit(revision, fallback).unwrap_err();
        assert!(matches!(refusal, Refusal::OtherRevision { .. }), "{refusal:?}");
    }
}

#[test]
fn keys_count_only_for_their_lambdas_and_vehicles() {
    let mut vehicle = TestVehicle::new();
    let envelope = signed_revision(1);
    let mut wish = deployment(1, &envelope);
    vehicle.root.publishers = vec![scoped(PUBLISHER, "brake", &[])];
    let refusal = vehicle.accept(&wish, &envelope).unwrap_err();
    assert!(matches!(refusal, Refusal::Scope { .. }), "{refusal:?}");
    assert!(refusal.to_string().contains("`brake`") && refusal.to_string().contains("brake-dark"));
    vehicle.root = root();
    vehicle.root.deployers = vec![scoped(DEPLOYER, "lane-*", &[])];
    assert!(matches!(vehicle.accept(&wish, &envelope), Err(Refusal::Scope { .. })));
    // Nor may a key replace the deployment of another lambda by one of its own.
    vehicle.root.deployers = vec![scoped(DEPLOYER, "brake-*", &[])];
    let id = std::mem::replace(&mut wish.id, "lane-keeper".parse().unwrap());
    let refusal = vehicle.accept(&wish, &envelope).unwrap_err();
    assert!(matches!(refusal, Refusal::ScopeId { .. }), "{refusal:?}");
    wish.id = id;
    vehicle.root.deployers = vec![scoped(DEPLOYER, "*", &[("fleet", "test")])];
    let refusal = vehicle.accept(&wish, &envelope).unwrap_err();
    assert!(matches!(&refusal, Refusal::ScopeLabel { found: None, .. }), "{refusal:?}");
    vehicle.labels = labelled(&[("fleet", "test"), ("site", "Köln")]);
    wish.selector = labelled(&[("site", "Ulm")]);
    let refusal = vehicle.accept(&wish, &envelope).unwrap_err();
    assert!(matches!(&refusal, Refusal::NotSelected { found: Some(_), .. }), "{refusal:?}");
    wish.selector = labelled(&[("site", "Köln")]);
    assert_eq!(vehicle.accept(&wish, &envelope), Ok(Verdict::Current));
}

#[test]
fn expiry_refuses_new_deployments_and_never_stops_an_accepted_one() {
    let mut vehicle = TestVehicle::new();
    let envelope = signed_revision(1);
    let wish = deployment(1, &envelope);
    vehicle.now = wish.expires - 1;
    vehicle.accept(&wish, &envelope).unwrap();
    vehicle.now = wish.expires;
    let expired = Refusal::Expired { what: "deployment", expires: wish.expires, now: wish.expires };
    assert_eq!(vehicle.accept(&wish, &envelope), Ok(Verdict::Stale(expired.clone())));
    vehicle.floors = Floors::default();
    assert_eq!(vehicle.accept(&wish, &envelope), Err(expired));
    // The same holds for the root.
    let mut long = deployment(2, &envelope);
    long.expires = SIGNED + 1000 * DAY;
    vehicle.accept(&long, &envelope).unwrap();
    vehicle.now = vehicle.root.expires;
    let verdict = vehicle.accept(&long, &envelope).unwrap();
    assert!(matches!(verdict, Verdict::Stale(Refusal::Expired { what: "trust root", .. })));
}

#[test]
fn a_clock_that_jumps_neither_revives_nor_bricks() {
    let mut vehicle = TestVehicle::new();
    let envelope = signed_revision(1);
    let built = BUILT;
    let wish = deployment(1, &envelope);
    vehicle.accept(&wish, &envelope).unwrap();
    // At 1970, a vehicle starts, by the signed time at least.
    assert_eq!(vehicle.floors.now(0, built), SIGNED);
    assert_eq!(Floors::default().now(0, built), built);
    // What had expired stays so when the clock is set back.
    vehicle.floors.observe(wish.expires, built);
    vehicle.now = vehicle.floors.now(0, built);
    let mut again = wish.clone();
    again.release = 2;
    assert!(matches!(vehicle.accept(&again, &envelope), Err(Refusal::Expired { .. })));
    // Far ahead and back again costs a year at most.
    for clock in [u64::MAX, 0, u64::MAX] {
        vehicle.floors.observe(clock, built);
    }
    vehicle.now = vehicle.floors.now(SIGNED + DAY, built);
    assert_eq!(vehicle.now, SIGNED + 366 * DAY);
    assert_eq!(
        vehicle.accept(&wish, &envelope).map(|verdict| verdict != Verdict::Current),
        Ok(true),
        "it runs on"
    );
    // A signer whose clock is far ahead moves it by a year, too.
    let mut ahead = deployment(3, &envelope);
    (ahead.created, ahead.expires) = (SIGNED + 9000 * DAY, SIGNED + 9001 * DAY);
    vehicle.root.expires = SIGNED + 9001 * DAY;
    vehicle.accept(&ahead, &envelope).unwrap();
    assert_eq!(vehicle.floors.now(0, built), SIGNED + 366 * DAY);
}

#[test]
fn ten_signatures_far_ahead_move_the_time_by_no_more_than_a_year() {
    let mut vehicle = TestVehicle::new();
    let envelope = signed_revision(1);
    vehicle.root.expires = SIGNED + 90_000 * DAY;
    for release in 1..=10 {
        let mut ahead = deployment(release, &envelope);
        (ahead.created, ahead.expires) = (SIGNED + 80_000 * DAY, SIGNED + 90_000 * DAY);
        vehicle.accept(&ahead, &envelope).unwrap();
        vehicle.floors.observe(u64::MAX, BUILT);
        // The installed root, at each start.
        vehicle.floors.accept_root(&root(), BUILT);
    }
    assert_eq!(vehicle.floors.now(0, BUILT), SIGNED + 366 * DAY);
    // Keys of the root move it on, a year with each root, however far ahead their clock is.
    let mut next = root();
    (next.version, next.created) = (2, SIGNED + 80_000 * DAY);
    for _ in 0..10 {
        vehicle.floors.accept_root(&next, BUILT);
        vehicle.floors.observe(u64::MAX, BUILT);
    }
    assert_eq!(vehicle.floors.now(0, BUILT), SIGNED + 2 * 366 * DAY);
    // A newer program, too.
    vehicle.floors.observe(u64::MAX, SIGNED + 1000 * DAY);
    assert_eq!(vehicle.floors.now(0, BUILT), SIGNED + 1366 * DAY);
}

#[test]
fn a_publisher_that_the_current_root_does_not_cover_is_refused_for_both_revisions() {
    let mut vehicle = TestVehicle::new();
    let other = 7;
    vehicle.root.publishers.push(scoped(other, "brake-*", &[]));
    let (old, new) = (seal(&revision(1), &[&key(other)]).unwrap(), signed_revision(2));
    let [old, new_one] = [&old, &new].map(|it| vehicle.verifier().revision(it).unwrap());
    let mut wish = deployment(1, &new);
    wish.fallback = Some(old.digest().clone());
    let envelope = seal(&wish, &[&key(DEPLOYER)]).unwrap();
    let wish = vehicle.verifier().deployment(&envelope).unwrap();
    assert_eq!(vehicle.verifier().admit(&wish, &new_one, Some(&old)), Ok(Verdict::Current));
    vehicle.floors.accept(&wish, &new_one, BUILT).unwrap();
    for (publishers, is_scope) in [
        (vec![scoped(PUBLISHER, "brake-*", &[])], false),
        (vec![scoped(other, "brake-*", &[])], false),
        (vec![scoped(PUBLISHER, "lane-*", &[]), scoped(other, "brake-*", &[])], true),
        (vec![scoped(PUBLISHER, "brake-*", &[]), scoped(other, "lane-*", &[])], true),
    ] {
        vehicle.root.publishers = publishers;
        let refusal = vehicle.verifier().admit(&wish, &new_one, Some(&old)).unwrap_err();
        let fits = match refusal {
            Refusal::UnknownKey { what: "revision", .. } => !is_scope,
            Refusal::Scope { .. } => is_scope,
            _ => false,
        };
        assert!(fits, "{refusal:?}");
    }
}

#[test]
fn a_fallback_is_older_than_its_revision_or_the_same() {
    let mut vehicle = TestVehicle::new();
    let mut other = revision(2);
    other.files.clear();
    let envelopes = [signed_revision(1), signed_revision(2), signed_revision(3)];
    let [first, second, third] =
        envelopes.each_ref().map(|it| vehicle.verifier().revision(it).unwrap());
    let other = seal(&other, &[&key(PUBLISHER)]).unwrap();
    let other = vehicle.verifier().revision(&other).unwrap();
    let wish = |vehicle: &TestVehicle, release, at: usize, fallback: &Trusted<Revision>| {
        let mut wish = deployment(release, &envelopes[at]);
        wish.fallback = Some(fallback.digest().clone());
        let envelope = seal(&wish, &[&key(DEPLOYER)]).unwrap();
        vehicle.verifier().deployment(&envelope).unwrap()
    };
    for (fallback, number) in [(&third, 3), (&other, 2)] {
        let wish = wish(&vehicle, 1, 1, fallback);
        assert_eq!(
            vehicle.verifier().admit(&wish, &second, Some(fallback)),
            Err(Refusal::NewerFallback { fallback: number, revision: 2 })
        );
    }
    let same = wish(&vehicle, 1, 1, &second);
    assert_eq!(vehicle.verifier().admit(&same, &second, Some(&second)), Ok(Verdict::Current));
    let older = wish(&vehicle, 1, 1, &first);
    assert_eq!(vehicle.verifier().admit(&older, &second, Some(&first)), Ok(Verdict::Current));
    vehicle.floors.accept(&older, &second, BUILT).unwrap();
    // Release 2 was accepted with another digest.
    let third_with = |fallback| wish(&vehicle, 2, 2, fallback);
    let refusal = vehicle.verifier().admit(&third_with(&other), &third, Some(&other)).unwrap_err();
    assert!(matches!(refusal, Refusal::SameRelease { .. }), "{refusal:?}");
    // An older release comes back as a fallback only where it ran.
    let wish = third_with(&first);
    let refused = Err(Refusal::UnknownFallback { fallback: 1, floor: 2 });
    assert_eq!(vehicle.verifier().admit(&wish, &third, Some(&first)), refused);
    vehicle.known.push(first.digest().clone());
    assert_eq!(vehicle.verifier().admit(&wish, &third, Some(&first)), Ok(Verdict::Current));
}

#[test]
fn accepting_checks_again_and_remembers_nothing_that_it_refuses() {
    let mut vehicle = TestVehicle::new();
    let [old, new] = [1, 2].map(signed_revision);
    let verified = |vehicle: &TestVehicle, id: &str, release, envelope: &[u8]| {
        let mut wish = deployment(release, envelope);
        wish.id = id.parse().unwrap();
        let envelope = seal(&wish, &[&key(DEPLOYER)]).unwrap();
        vehicle.verifier().deployment(&envelope).unwrap()
    };
    let [old_one, new_one] = [&old, &new].map(|it| vehicle.verifier().revision(it).unwrap());
    // Both are admitted before one of them is accepted.
    let (front, rear) = (verified(&vehicle, "front", 2, &new), verified(&vehicle, "rear", 1, &old));
    let back = verified(&vehicle, "front", 1, &new);
    for (wish, revision) in [(&front, &new_one), (&rear, &old_one), (&back, &new_one)] {
        assert_eq!(vehicle.verifier().admit(wish, revision, None), Ok(Verdict::Current));
    }
    vehicle.floors.accept(&front, &new_one, BUILT).unwrap();
    let before = vehicle.floors.clone();
    let refusals = [(&rear, &old_one), (&back, &new_one), (&front, &old_one)]
        .map(|(wish, revision)| vehicle.floors.accept(wish, revision, BUILT).unwrap_err());
    assert!(matches!(refusals[0], Refusal::RolledBack { floor: 2, found: 1, .. }));
    assert!(matches!(refusals[1], Refusal::RolledBack { floor: 2, found: 1, .. }));
    assert!(matches!(refusals[2], Refusal::OtherRevision { .. }));
    assert_eq!(vehicle.floors, before);
}

#[test]
fn a_name_beyond_the_maximum_is_refused_and_not_stored() {
    let mut vehicle = TestVehicle::new();
    let envelope = signed_revision(1);
    let digest = "0".repeat(64);
    let names = (0..4096).map(|n| format!(r#""d{n}":{{"release":1,"digest":"{digest}"}}"#));
    let names = names.collect::<Vec<_>>().join(",");
    let text = String::from_utf8(vehicle.floors.to_json()).unwrap();
    let full = text.replace(r#""deployments":{}"#, &format!(r#""deployments":{{{names}}}"#));
    vehicle.floors = Floors::parse(full.as_bytes()).unwrap();
    let wish = seal(&deployment(1, &envelope), &[&key(DEPLOYER)]).unwrap();
    let wish = vehicle.verifier().deployment(&wish).unwrap();
    let revision = vehicle.verifier().revision(&envelope).unwrap();
    let refusal = vehicle.floors.accept(&wish, &revision, BUILT);
    assert_eq!(refusal, Err(Refusal::TooManyFloors { count: 4096 }));
    assert!(vehicle.floors == Floors::parse(full.as_bytes()).unwrap());
    // A name that is known is accepted.
    let mut known = deployment(2, &envelope);
    known.id = "d7".parse().unwrap();
    assert_eq!(vehicle.accept(&known, &envelope), Ok(Verdict::Current));
}

/// The root after `root()`, with other root keys of which two must sign.
fn second_root() -> TrustRoot {
    let keys = [21, 22, 23].map(|seed| key(seed).public()).to_vec();
    let mut next = root();
    (next.version, next.root) = (2, RootKeys { threshold: 2, keys });
    next
}

#[test]
fn a_new_root_is_signed_by_the_keys_of_both_and_comes_in_sequence() {
    let signed = |root: &TrustRoot, seeds: &[u8]| {
        let keys: Vec<_> = seeds.iter().map(|seed| key(*seed)).collect();
        seal(root, &keys.iter().collect::<Vec<_>>()).unwrap()
    };
    let (mut first, second) = (root(), second_root());
    // Expired long ago: a vehicle that was off can catch up.
    first.expires = 1;
    assert_eq!(next_root(&first, &signed(&second, &[ROOT, 21, 22])), Ok(second.clone()));
    assert_eq!(next_root(&first, &signed(&second, &[23, ROOT, 9, 21])), Ok(second.clone()));
    assert_eq!(
        next_root(&first, &signed(&second, &[ROOT, 21])),
        Err(Refusal::Threshold { version: 2, by: "its own keys", valid: 1, needed: 2 })
    );
    let refusal = next_root(&first, &signed(&second, &[21, 22])).unwrap_err();
    assert!(matches!(refusal, Refusal::UnknownKey { .. }), "{refusal:?}");
    let mut third = second.clone();
    third.version = 3;
    assert_eq!(
        next_root(&first, &signed(&third, &[ROOT, 21, 22])),
        Err(Refusal::Sequence { current: 1, found: 3 })
    );
    assert_eq!(
        next_root(&second, &signed(&third, &[21])),
        Err(Refusal::Threshold { version: 3, by: "the current keys", valid: 1, needed: 2 })
    );
    assert_eq!(next_root(&second, &signed(&third, &[21, 23])), Ok(third));
    let refusal = next_root(&second, &signed(&second, &[21, 22])).unwrap_err();
    assert!(matches!(refusal, Refusal::Sequence { .. }), "{refusal:?}");
    // After the second one, the first cannot be installed again.
    let mut floors = Floors::default();
    let envelope = signed(&root(), &[ROOT]);
    floors.accept_root(&first_root(&envelope, &floors).unwrap(), 0);
    floors.accept_root(&second, 0);
    assert_eq!(first_root(&envelope, &floors), Err(Refusal::OldRoot { found: 1, floor: 2 }));
    let refusal = first_root(&signed(&second, &[21]), &floors).unwrap_err();
    assert!(matches!(refusal, Refusal::Threshold { .. }), "{refusal:?}");
}

#[test]
fn a_kill_between_the_file_of_a_root_and_the_floors_is_repaired_at_the_next_start() {
    let (mut floors, mut second) = (Floors::default(), root());
    second.version = 2;
    let [first_file, second_file] = [&root(), &second].map(|it| seal(it, &[&key(ROOT)]).unwrap());
    floors.accept_root(&first_root(&first_file, &floors).unwrap(), BUILT);
    // Killed with the file of the second root in place, and the floors of the first.
    let mut after = floors.clone();
    let root = first_root(&second_file, &after).unwrap();
    after.accept_root(&root, BUILT);
    assert_eq!(first_root(&first_file, &after), Err(Refusal::OldRoot { found: 1, floor: 2 }));
    // In the other order, the vehicle would have no root.
    floors.accept_root(&second, BUILT);
    assert_eq!(first_root(&first_file, &floors), Err(Refusal::OldRoot { found: 1, floor: 2 }));
}

#[test]
fn the_help_for_a_root_names_what_to_do_with_roots() {
    let stranger = seal(&root(), &[&key(9)]).unwrap();
    let unsigned = next_root(&root(), &stranger).unwrap_err();
    let old = Refusal::OldRoot { found: 1, floor: 2 };
    let expired = Refusal::Expired { what: "trust root", expires: 1, now: 2 };
    for (refusal, help) in [
        (unsigned, "signatures by the keys of the current one"),
        (old, "install the newest trust root"),
        (expired, "install the next trust root"),
    ] {
        assert!(refusal.help().is_some_and(|found| found.contains(help)), "{refusal}");
    }
}
