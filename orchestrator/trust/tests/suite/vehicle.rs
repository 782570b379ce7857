//! Scopes, releases that go back, expiry, clocks that jump, and new trust roots.

use gleaner_trust::{Deployment, Refusal, Revision, Trusted, Verdict, first_root, next_root};

use super::*;

/// The time at which the vehicle's program was built.
const BUILT: u64 = SIGNED - 100 * DAY;

/// A vehicle with its own state.
struct TestVehicle {
    root: TrustRoot,
    floors: Floors,
    labels: Labels,
    now: u64,
}

impl TestVehicle {
    fn new() -> Self {
        Self { root: root(), floors: Floors::default(), labels: Labels::new(), now: SIGNED }
    }

    fn verifier(&self) -> Verifier<'_> {
        let Self { root, floors, labels, now } = self;
        Verifier { root, floors, labels, now: *now }
    }

    /// Verifies both, and accepts them.
    fn accept(&mut self, deployment: &Deployment, revision: &[u8]) -> Result<Verdict, Refusal> {
        let envelope = seal(deployment, &[&key(DEPLOYER)]).unwrap();
        let verifier = self.verifier();
        let revision = verifier.revision(revision)?;
        let deployment = verifier.deployment(&envelope)?;
        let verdict = verifier.admit(&deployment, &revision, None)?;
        self.floors.accept(&deployment, &revision, BUILT);
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
    assert_eq!(
        first_root(&envelope, &floors),
        Err(Refusal::RolledBack { what: "trust root".to_owned(), found: 1, floor: 2 })
    );
    let refusal = first_root(&signed(&second, &[21]), &floors).unwrap_err();
    assert!(matches!(refusal, Refusal::Threshold { .. }), "{refusal:?}");
}
